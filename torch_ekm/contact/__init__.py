"""HOW the hand touches the object: contacts, grasp matrices, contact forces."""
