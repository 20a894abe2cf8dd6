"""WHERE its points are: forward kinematics, Jacobians, the actuation map."""
