"""Diffusion without networks: schedules, noising, the posterior step, samplers, inpainting, the rolling conveyor.

A noise level is a number in [0, 1] per frame, "batch time": 0 is clean, 1 is pure noise. One level per window
("batch 1") is the broadcast case of one per frame, one per frame that of one per frame and modality; a published step
t of S is the level t / S.
"""
