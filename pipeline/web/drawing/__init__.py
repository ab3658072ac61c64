"""Drawing of bodies in a browser: colours, bodies by kind, smoke, and the canvas, shared by the viewer and live."""
