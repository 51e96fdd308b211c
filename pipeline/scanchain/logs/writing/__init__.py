"""Messages packed and written as MCAP."""
