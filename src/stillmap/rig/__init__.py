"""What 3D recordings need besides: the ground, and the plan of what is in the robot's way."""
