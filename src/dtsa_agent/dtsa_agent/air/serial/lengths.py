"""Lengths on the line, apart from the code of its frames: settings are read where the extra ``serial`` is missing."""

OVERHEAD = 5  # bytes around a datagram: two zeros, the byte of COBS, the check sum
LONGEST = 250  # bytes of a datagram
