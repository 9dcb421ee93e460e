"""A street of the built-in world: positions are (s, d), metres along its centre line and to the left of it.

Read `street` first; `course` is its centre line, `street_plan` draws one from a random generator.
"""
