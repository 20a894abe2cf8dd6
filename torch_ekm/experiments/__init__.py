"""Claims: protocols, metrics, figures, reports."""
