"""Scene files: what is rendered and how the camera moves, declared in TOML and checked before Blender starts.

Lengths are metres, angles degrees, the world's z axis points up. Colours are sRGB, as colour pickers show them:
``"#RRGGBB"`` or three numbers from 0 to 1.
"""
