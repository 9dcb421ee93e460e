"""Many vehicles on one network: each publishes its estimates at a router, and authorised listeners receive them all.

    vehicle's bus --> [uplink] --mutual TLS--> [router] --mutual TLS--> listeners: `birdslam top --all`, Fleet

`uplink` is a planner of its own vehicle's bus that forwards to the router what it receives; only queries come in.
`router` lets each vehicle write its own keys alone. `listener` is the client of all vehicles.
docs/deployment.md sets it up.
"""
