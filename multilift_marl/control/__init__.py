"""Control: thrust allocation, the geometric controller, the formation and the action interfaces."""
