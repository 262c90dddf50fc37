"""Routes: each turns HTTP into one call and a typed answer."""
