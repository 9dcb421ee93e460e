"""Processes many drives offline, each in one process, with results as for a run and one report of all.

`drives` finds them, `offline` is the pipeline, `drive` processes one, `local` runs many in parallel, `report`
summarizes them.
"""
