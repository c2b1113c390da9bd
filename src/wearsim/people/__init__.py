"""The simulated person: activities, the plan that they write, and the motion of the whole body made from it."""
