"""What the UAVs know of their own place: navigation solutions and the errors in them."""
