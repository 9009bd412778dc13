"""Measurements of people: girths, lengths, widths and heights, carried from a template to every registered body."""
