"""The factors of the graph, a module for each: residual, Jacobian, information and the equation's number.

Read `factor` first, then `standard`, which has the list that the graph takes by default.
"""
