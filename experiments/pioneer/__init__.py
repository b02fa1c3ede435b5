"""The paper's simulated robot: McGovern & Barto (2001), §7."""
