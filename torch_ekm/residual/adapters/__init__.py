"""Other libraries' regressors as learners."""
