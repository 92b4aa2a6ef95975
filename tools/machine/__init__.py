"""Sets the machine up and starts the commands. Standard library only: runs before anything is installed."""
