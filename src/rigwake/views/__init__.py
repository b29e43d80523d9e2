"""Views of a calibrated rig: level strips, panoramas, top views, and what they are measured by."""
