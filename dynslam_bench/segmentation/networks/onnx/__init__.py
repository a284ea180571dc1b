"""Segmentation networks in ONNX files."""
