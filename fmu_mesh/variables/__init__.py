"""What an instance offers: its model description, variables, their types, values and units. Imports only `errors`."""
