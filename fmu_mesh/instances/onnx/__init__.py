"""ONNX models as instances; the only package that imports onnxruntime."""
