"""From the workstation to the car: ONNX artifacts, map tiles, synthetic recordings."""
