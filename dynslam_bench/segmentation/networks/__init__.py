"""Segmentation networks: Mask R-CNN, ONNX files, and where their weights lie."""
