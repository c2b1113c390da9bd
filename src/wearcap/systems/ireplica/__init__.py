"""iReplica: hand contacts predicted from pose, and objects moved by them."""
