"""Many vehicles on one network: each publishes its estimates to a router; authorised listeners receive all of them.

    vehicle's bus --> [uplink] --mutual TLS--> [router] --mutual TLS--> listeners: `birdslam top --all`, Fleet

`uplink` forwards from its vehicle's bus to the router; only queries come in. `router` lets each vehicle write its own
keys only. `listener` is the client of all vehicles. docs/deployment.md describes the setup.
"""
