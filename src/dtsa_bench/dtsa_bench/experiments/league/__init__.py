"""The league: frozen cells that any policy flies, entries that anybody can check, and the table of all.

``league-1.yaml`` is what is frozen; see docs/how-to/league.md.
"""
