"""Many independent runs: handed to all cores or a cluster, kept in a journal, summed up in tables.

`sweep` and `protocol_bench` say what a run is and what it is worth; everything else about many runs is here. A plan
(:class:`~dtsa_bench.batch.task.Plan`) names the runs, a work (:class:`~dtsa_bench.batch.task.Work`) does one of them.
"""
