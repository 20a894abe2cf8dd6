"""SAPIEN and MuJoCo: bodies, contacts, time."""
