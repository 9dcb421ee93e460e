"""The multiple-model filter of all road users: state, motion, measurement of a box; classes are tables of priors."""
