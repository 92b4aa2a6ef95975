"""Tables in the documents that are made from code and records."""
