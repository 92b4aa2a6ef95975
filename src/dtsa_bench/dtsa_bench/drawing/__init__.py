"""How flights and figures look: colours, style, and the picture of a flight's paths. It imports `runs`."""
