"""Files that wearable devices and their services write."""
