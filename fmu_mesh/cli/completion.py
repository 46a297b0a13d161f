PARSERS = {"logs": lambda p: None, "new": lambda p: None, "completion": lambda p: None}
