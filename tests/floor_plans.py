"""Plans of the floors that real surround rigs were calibrated on by their makers."""

from rigwake.views.rig_sources import FloorPlan

# sizes of the plans that the homographies were made for, from the makers' settings, and how far a top view reaches, m
FLOOR_PLANS = {
    "surround_neozhaoliang": (FloorPlan(1200, 1600, 550, 500), 8.0),
    "marine_boat360": (FloorPlan(750, 650, 220, 220), 4.5),
}
