"""server/trompe_server"""
