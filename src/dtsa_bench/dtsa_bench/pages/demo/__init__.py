"""The demo: nine recorded flights that show, in four steps, what this software is about.

`flights` flies and reads them, `picture` draws them.
"""
