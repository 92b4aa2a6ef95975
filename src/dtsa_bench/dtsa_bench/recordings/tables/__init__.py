"""A recorded run as tables: for the report, for data frames, and as files."""
