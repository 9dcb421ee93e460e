"""People, cyclists and riders in bird's-eye view, with ids that persist through a second of occlusion.

`people_boxes` reads a detector's boxes, `box_model` makes measurements of them for the filter of all road users,
`people_tracker` tracks, `people_records` makes the records of a frame.
"""
