"""The command line, its commands, and what they share. Nothing imports it but the package's entry."""
