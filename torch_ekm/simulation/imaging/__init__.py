"""Pictures that a camera would take of marker cards and fingers."""
