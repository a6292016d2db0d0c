"""The tab 'Scanback' in the sidebar of the 3D Viewport."""
