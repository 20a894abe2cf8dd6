"""The kinematic model f(s, da): potential, stiffness, manipulation Jacobian."""
