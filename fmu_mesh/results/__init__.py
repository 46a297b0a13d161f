"""Result files: one module per format that writes, reads, follows and recovers its files, behind one contract."""
