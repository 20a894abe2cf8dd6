"""Contact and actuator forces of a grasp: the relaxed minimal-force problem and its answer."""
