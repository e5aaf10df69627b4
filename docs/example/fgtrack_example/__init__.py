"""Parts for fgtrack."""
