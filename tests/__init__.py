"""Tests; the folders are not packages but for what others import."""
