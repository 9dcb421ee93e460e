"""The factors of the graph, one per module: residual, Jacobian, information and the equation's number.

Read `factor` first, then `standard`, which lists the default factors.
"""
