"""Files of other people: ZIP archives, files inside them, and XML, each protected against hostile content."""
