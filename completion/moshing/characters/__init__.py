"""Motions and soft tissue on characters."""
