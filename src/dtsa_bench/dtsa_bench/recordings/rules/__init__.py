"""The rules of the slot protocols, judged from frames alone; `verify`, `merge` and `sniff` share it."""
