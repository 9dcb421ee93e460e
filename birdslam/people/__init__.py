"""People, cyclists and riders in bird's-eye view, with ids that last through a second of hiding.

`people_boxes` reads a detector's boxes, `people_filter` places them by the foot on the road and by their height,
`people_tracker` follows them, `people_edges` makes the records of a frame.
"""
