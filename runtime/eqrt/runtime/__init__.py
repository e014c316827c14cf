"""What ships to the car: CAN in, tracks, predictions out. Never imports torch or onnx."""
