"""A swarm in a browser while it flies: sources, a server on this machine, its page."""
