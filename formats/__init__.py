"""Files of fusedrf: bundles, scene graphs, captures, pictures and meshes as plain numpy records.

Knows files, numpy and safetensors; never torch, click or `fusedrf_cli`. Every byte that is read is treated as
untrusted.
"""
