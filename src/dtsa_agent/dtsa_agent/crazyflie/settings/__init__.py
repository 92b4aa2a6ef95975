"""The swarm's settings file, and whether what it asks for fits on the air."""
