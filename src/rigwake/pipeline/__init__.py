"""From a recording to a calibrated rig."""
