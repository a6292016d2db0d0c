"""What the user can do: operators hold properties, make one call and report once."""
