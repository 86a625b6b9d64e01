"""renderer_worker/trompe_renderer"""
