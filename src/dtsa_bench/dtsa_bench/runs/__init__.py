"""What a run is: its settings, its figures of merit, and what one says of them.

Every kind of run shares this: simulated, with nodes, merged from agents' bags. It imports nothing else of the bench.
"""
