"""The processes: capture, perceive, optimize, record. `nodes` defines the nodes, `runner` the loop that runs them."""
