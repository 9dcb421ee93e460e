"""People, cyclists and riders in bird's-eye view, with ids that last through a second of hiding.

`people_boxes` reads a detector's boxes, `box_model` says what the box of somebody looks like, `people_motion` how
people move, `road_tilt` how the road lies under them; `people_filter` estimates places, velocities and heights by
these, `people_tracker` follows everybody, `people_records` makes the records of a frame.
"""
