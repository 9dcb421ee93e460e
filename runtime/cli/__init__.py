"""The command `birdslam`: one module a command; `*_options` have the command lines, imported before numpy.

Read `main` first.
"""
