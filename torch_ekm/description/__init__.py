"""WHAT the robot is: hands and objects as data, read from URDF and transmission files."""
