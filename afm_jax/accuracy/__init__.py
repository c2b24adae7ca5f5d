"""What a digit costs: error against computing time of impacts, collisions and scenes."""
