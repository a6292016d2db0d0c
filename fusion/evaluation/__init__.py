"""How close a surface is to the truth."""
