"""Waits without an end, in libraries that have them wrong; ``_endless.c`` says which. Compiled."""

# Number of places in which the libraries with this in their files' names call us now; 0: none of them needs it.
def mend(library: str, /) -> int: ...
