"""Many drives: each through the whole pipeline in one process, offline; results as for a run, one report of all.

`drives` finds them, `offline` is the pipeline, `drive` takes one through it, `local` has many at once on this computer,
`report` sums them up.
"""
