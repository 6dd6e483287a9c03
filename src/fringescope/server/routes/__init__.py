"""HTTP and WebSocket to the parts of the hub and back; a route asks who may, and decides nothing else."""
