"""ECHO: human, object and contacts from head and wrists by one diffusion model."""
