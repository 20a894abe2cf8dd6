"""Hall readings: calibration and joint angles."""
