"""The variables of an instance: model description, types, values and units. Imports only `errors`."""
