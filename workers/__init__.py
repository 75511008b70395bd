"""Executors: they obey what a stage declares and never know what it computes."""
