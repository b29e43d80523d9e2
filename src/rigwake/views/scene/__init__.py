"""What stands on the water: water, obstacle and sky in the level strip, and upright obstacles as stixels."""
