"""Outputs of networks to findings: one module a family of networks; manifests name them."""
