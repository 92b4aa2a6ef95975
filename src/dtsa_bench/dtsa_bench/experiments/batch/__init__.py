"""Many independent runs: handed to all cores or a cluster, kept in a journal, summed up in tables.

Who uses it says what a run is and what it is worth; everything else about many runs is here. A plan
(:class:`.task.Plan`) names the runs, a work (:class:`.task.Work`) does one of them.
"""
