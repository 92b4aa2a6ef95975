"""The safety rules, and where those that land come down. Pure."""
