"""The report: one self-contained HTML page of one recorded run, or of several side by side.

`data` works out what the page shows, `page` puts it together with the page's own script and style. `sweep` is the page
of a sweep.
"""
