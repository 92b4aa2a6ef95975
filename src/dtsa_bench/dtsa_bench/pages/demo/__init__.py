"""The demo: nine recorded flights that tell, in four steps, what this software is about.

`story` says which flights these are, `flying` flies them, `live` kills an agent in the last one, `flown` reads what is
shown from their bags, `text` says it, `table` has the numbers, `picture`, `page` and `animation` show it.
"""
