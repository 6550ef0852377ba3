"""The desktop viewer: Qt windows over state that knows no Qt. Importing this package loads no Qt."""
