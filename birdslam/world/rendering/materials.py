"""Constants shared by meshes and shading: materials, body kinds, and slots of a body's parameters."""

(
    GROUND,
    PAINT,
    WHEEL,
    CARGO,
    WALL,
    PLAIN,
    FOLIAGE,
    BARK,
    METAL,
    PANEL,
    CLOTH,
    FENCE,
    CONCRETE,
    CONTAINER,
    DARK,
    SKIN,
) = range(16)
(VEHICLE, TRUCK, PEDESTRIAN, CYCLIST, BUILDING, TREE, HEDGE, POST, SIGN, CRATE, WALLING, BRIDGE, LIGHTS) = range(13)

# Slots that every body has
(RED, GREEN, BLUE, GLOSS, SEED, LENGTH, WIDTH, HEIGHT) = range(8)
# Vehicles: x from the rear (-) to the front (+) of the body, z over the road
(
    CLEARANCE,
    BELT,  # height of the window sill
    X_COWL,  # foot of the windscreen
    X_SCREEN_TOP,
    X_ROOF_END,
    X_BACK_BOTTOM,  # foot of the rear window
    Z_NOSE,
    Z_COWL,
    Z_TAIL,
    TUMBLE,  # inclination of the windows, in metres at the roof
    ROUND_FRONT,
    ROUND_REAR,
    WHEEL_RADIUS,
    X_FRONT_AXLE,
    X_REAR_AXLE,
    X_PILLAR,
    GLASS,  # transmittance of the windows
    X_GLASS_END,  # rear end of the side windows
    BRAKING,
    PLATE,  # 0 white, 1 yellow, 2 none
    HEADLIGHTS,
    RIM,
    DIRT,
    X_PILLAR_2,
    LAMPS,
    CLADDING,
    CARGO_KIND,  # 0 box, 1 curtain, 2 tank, 3 tipper, 4 flat bed, 5 mixer
    CARGO_X0,
    CARGO_X1,
    CARGO_Z0,
    CARGO_RED,
    CARGO_GREEN,
    CARGO_BLUE,
    PICTURE,
    LOFT_X0,
    LOFT_X1,
    PHASE,  # of a stride, in radians
) = range(8, 45)
# All other kinds use slots from 8 as their meshes define
SLOTS = 48
