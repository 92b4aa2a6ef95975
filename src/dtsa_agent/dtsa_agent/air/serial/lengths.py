"""Lengths on the line, apart from the code of its frames: settings are read where the extra ``serial`` is missing."""

OVERHEAD = 5  # bytes around a datagram: two zeros, the byte of COBS, the check sum
HEADER = 8  # bytes of a datagram before its frame: two of the settings, two of times, four of one whom its sender hears
FRAMING = HEADER + OVERHEAD  # bytes around a frame
LONGEST = 250  # bytes of a datagram
