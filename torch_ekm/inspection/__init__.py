"""Look at a hand, a grasp or a log before anything is driven: ``check``, and pages of ``show``."""
