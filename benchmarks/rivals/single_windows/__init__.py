"""How training windows were drawn before they were drawn in batches: one by one, each from the recordings on its own.

Kept to compare speeds and losses with. `compose.compose_before` makes it from the configs of the trainings of today.
"""
