"""From raw readings to joint angles and poses."""
