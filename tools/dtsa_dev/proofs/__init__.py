"""libdtsa without Python around it: fuzzed, flown on a microcontroller, explored state by state."""
