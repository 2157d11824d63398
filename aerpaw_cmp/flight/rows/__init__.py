"""Rows that count: positions that are scored, a sounder in lock."""
