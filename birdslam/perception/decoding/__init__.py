"""Decoders from network outputs to findings, one module for each family of networks; manifests name them."""
