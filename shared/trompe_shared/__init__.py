"""What two of the other packages must agree on: API schemas, wire protocol, scene geometry, object format."""
