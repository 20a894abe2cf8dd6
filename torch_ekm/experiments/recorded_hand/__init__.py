"""Predicting the recorded motions of a real hand: the Yale T42."""
