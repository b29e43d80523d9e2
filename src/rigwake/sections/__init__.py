"""Which parts of a long recording to calibrate from: what each tells of the rig, the smallest set of them."""
