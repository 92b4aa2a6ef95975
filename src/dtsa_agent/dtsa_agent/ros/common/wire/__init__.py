"""Messages as bytes and arrays, and the checks of what comes in."""
