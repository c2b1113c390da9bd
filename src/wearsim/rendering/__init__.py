"""What cameras and laser scanners measure of a simulated world."""
