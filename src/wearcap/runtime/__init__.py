"""How captures and networks run: stages with a cache, and ONNX Runtime."""
