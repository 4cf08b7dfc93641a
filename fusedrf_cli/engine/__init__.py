"""The numeric engine: fields, composition, rendering, distillation. Knows torch and the kernels, never click
or files."""
