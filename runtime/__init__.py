"""The runtime around the method: three processes, the bus, the supervisor, the command line.

Read `topology` first: all topics and nodes. `nodes` has the code of each process, `supervision` starts and watches
them, `configuration` has all settings. The computation is in birdslam/.
"""
