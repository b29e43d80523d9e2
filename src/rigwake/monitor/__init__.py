"""Has a camera moved since it was calibrated?"""
