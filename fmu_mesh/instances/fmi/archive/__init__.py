"""The .fmu file: unpacking it, examining it, reading its model description, compiling its sources."""
