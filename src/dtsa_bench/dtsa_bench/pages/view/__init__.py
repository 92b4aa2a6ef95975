"""A swarm in a browser while it flies, and recorded flights played: sources, a server on this machine, its page."""
