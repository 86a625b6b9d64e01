"""client/trompe_client"""
