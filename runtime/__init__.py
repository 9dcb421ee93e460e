"""The shell around the method: three processes, the bus, the supervisor, the command line.

Read `topology` first: every topic and every node on one screen. `nodes` is what each process does, `supervision`
starts and watches them, `configuration` is everything that can be set. What computes stands in birdslam/.
"""
